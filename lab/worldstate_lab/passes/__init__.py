"""The whole chain on simulated streams: beliefs while vehicles approach, pass and leave."""
