"""Measures scopemap: plans, scoring, tables, baselines, phantoms, and research data sets."""
