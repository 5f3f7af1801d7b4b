"""`python -m jaxshape` is `jaxshape`."""

from jaxshape.cli import main

if __name__ == "__main__":
    main()
