"""Seeded rooms with known truth, a camera walk through them, and a depth sensor: data for the demo and the tests."""
