"""World-states for viewers, logs and other stacks: Foxglove, MCAP, OSI, Autoware, ODAS."""
