"""Accuracy of positions behind the corner: simulated passes, and real maps with a metric truth."""
