"""Linear algebra that knows no X-rays."""
