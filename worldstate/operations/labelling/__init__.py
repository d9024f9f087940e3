"""Labels from smoothed passes: positions before a vehicle is visible, and the time of line of sight."""
