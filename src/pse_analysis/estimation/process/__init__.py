"""How a state may move between instants: dynamics and process noise."""
