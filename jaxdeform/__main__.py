"""The command line as a module: ``python -m jaxdeform``."""

from jaxdeform._apps.cli import main

if __name__ == "__main__":
    main()
