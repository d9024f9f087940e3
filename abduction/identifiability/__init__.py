"""What any detector could reach: information and Fisher bounds, "Evidence of Absence", section VI."""
