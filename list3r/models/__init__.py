"""Neural models: what they are, where their weights come from, what they may be used for."""
