"""The branches of cycles behind the ladder of states."""
