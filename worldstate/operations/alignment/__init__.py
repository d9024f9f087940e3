"""How a camera stands to the array, in time and in yaw, from vehicles that both noticed."""
