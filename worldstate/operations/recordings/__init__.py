"""One recording through the whole chain: hops, advisories, channel health, the timeline figure."""
