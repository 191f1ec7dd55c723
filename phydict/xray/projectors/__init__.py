"""Line integrals and their exact adjoints, one file per way to compute them."""
