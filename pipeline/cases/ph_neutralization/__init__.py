"""pH in a tank, sampled every minute or every 15 s."""
