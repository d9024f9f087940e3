"""What any detector could reach: information and Fisher bounds, section VI of the paper."""
