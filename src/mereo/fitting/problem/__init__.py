"""One frame to be explained by one object: terms of the fit, their least squares and the Gaussian that these leave."""
