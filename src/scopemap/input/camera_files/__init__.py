"""Camera file formats, one per file. Readers raise `ValueError`; `reading` adds the name of the file."""
