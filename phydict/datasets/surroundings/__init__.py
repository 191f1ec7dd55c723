"""What lies around a chest in the scanner: couches, covers, arms beside the body, leads on the skin."""
