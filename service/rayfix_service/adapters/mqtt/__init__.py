"""Locating from an MQTT broker: its settings, and the session that reads it."""
