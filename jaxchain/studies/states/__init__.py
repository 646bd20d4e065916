"""The paper's states: their motion, phases and delays."""
