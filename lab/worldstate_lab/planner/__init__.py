"""A planner that uses the chances of the state at a blind corner, compared with a worst-case planner."""
