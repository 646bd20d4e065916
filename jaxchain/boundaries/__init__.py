"""Where vibration starts (Hopf) and up to where it can survive (fold)."""
