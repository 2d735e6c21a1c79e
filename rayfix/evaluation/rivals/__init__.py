"""Other ways to locate from the same reports, which ``rayfix evaluate`` puts beside rayfix on the same draws."""
