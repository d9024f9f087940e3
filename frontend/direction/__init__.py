"""Direction of arrival: SRP-PHAT, MUSIC, delays, peaks, bearing, the published feature."""
