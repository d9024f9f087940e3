"""The whole chain on simulated streams: who is believed where while vehicles come, pass and go."""
