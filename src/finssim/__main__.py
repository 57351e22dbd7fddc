"""`python -m finssim` is the `finssim` command."""

from finssim.cli.commands import main

if __name__ == "__main__":
    main()
