"""Which pixels show usable tissue: field of view, exposure, highlights, overlays, instruments."""
