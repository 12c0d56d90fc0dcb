"""Looking at a controller: an episode in the browser, as a film, as a picture."""
