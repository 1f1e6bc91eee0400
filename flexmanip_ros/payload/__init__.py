"""What the arm holds, from an identified model or from its dynamics."""
