"""What an adapter hands to the filter, and the roles that a modality can play."""
