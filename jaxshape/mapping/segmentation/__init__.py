"""Which pixels of a depth frame show the object: planes, clusters, and the choice among them."""
