"""Tests of rayfix. What several of their modules use is in ``tests.support``; no test module imports another."""
