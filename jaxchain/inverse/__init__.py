"""From the wanted or the measured to the chain: design and identification."""
