"""Look at a result: films, paintings, the page."""
