"""Many videos, on one machine or many."""
