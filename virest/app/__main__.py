"""``python -m virest.app`` is ``virest``."""

from virest.app.cli import main

if __name__ == "__main__":
    main()
