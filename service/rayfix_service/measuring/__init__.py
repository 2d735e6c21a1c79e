"""Ranges from what receivers measure: times, signal strengths and impulse responses."""
