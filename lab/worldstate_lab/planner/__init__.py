"""A planner that reads the chances of the state at a blind corner, beside one that assumes the worst."""
