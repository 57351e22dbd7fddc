"""`python -m finssim` is the `finssim` command."""

from finssim.cli import main

if __name__ == "__main__":
    main()
