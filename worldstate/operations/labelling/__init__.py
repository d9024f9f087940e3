"""Labels from smoothed passes: places while only heard, and the time of line of sight."""
