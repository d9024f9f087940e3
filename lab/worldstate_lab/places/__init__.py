"""How well a place behind the corner is known: simulated passes, and real maps with a metric truth."""
