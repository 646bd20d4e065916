"""The paper's states, regular or chaotic."""
