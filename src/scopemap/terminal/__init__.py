"""What the commands share: options, progress, figures, interruption."""
