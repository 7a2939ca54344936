"""The playground: a plant and two of its controllers in a browser, from files alone."""
