"""Other positioning methods for comparison with rayfix."""
