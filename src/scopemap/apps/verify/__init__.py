"""Is a result as it was written?"""
