"""Methods side by side on the same sequences: plans, resumable runs, scores, tables, figures."""
