"""From plants and plant data to published controllers. ``serving`` runs them on a plant."""
