"""What a checkout shows and tests with, and the package does not need."""
