"""What is peculiar about a clinical video: `inspect` reads it once and says what was found; one kind in each file."""
