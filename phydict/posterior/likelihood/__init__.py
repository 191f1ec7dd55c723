"""What moves a state towards the X-rays."""
