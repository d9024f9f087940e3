"""Labels from smoothed passes: who was where while only heard, and when each came into line of sight."""
