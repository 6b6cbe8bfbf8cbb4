"""Files of poses, ours and other people's: one module per family of forms, `opening` to tell them apart."""
