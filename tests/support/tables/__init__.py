"""Tables made by hand, at random, or damaged."""
