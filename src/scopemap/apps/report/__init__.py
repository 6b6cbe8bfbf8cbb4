"""The page of a result, made again."""
