"""From plants and plant data to published controllers."""
