"""One run of a chain, smoothed or event by event, and the accuracy it is given."""
