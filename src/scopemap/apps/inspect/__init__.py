"""Inspection of a clinical video: `inspecting.inspect` reads it once and reports quality and format findings."""
