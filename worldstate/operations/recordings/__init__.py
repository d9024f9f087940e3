"""Processing of one recording: hops, advisories, channel health and the timeline figure."""
