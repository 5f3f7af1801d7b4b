"""What a user would reach for otherwise. Each module needs a package that may not be there."""
