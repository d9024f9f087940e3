"""A structured world-state, kept alive when a sensor goes blind."""
