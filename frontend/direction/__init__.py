"""Direction of arrival: SRP-PHAT, MUSIC, peaks, bearing, the published feature."""
