"""Where the object stands, how it is turned and how large it is, by what the prior explains."""
