"""Rules for compiled functions, and square-root linear algebra."""
