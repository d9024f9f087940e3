"""The whole chain on simulated streams: what is believed while vehicles come, pass and go."""
