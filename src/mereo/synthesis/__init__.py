"""Virtual depth camera, query points, labelled examples, and datasets of them."""
