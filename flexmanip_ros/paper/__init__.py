"""The reproduction of the paper's section 4."""
