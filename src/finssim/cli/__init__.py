"""The command line: commands made from the functions of the other packages."""


def main() -> None:
    """Run the command line and exit."""
    from finssim.cli.commands import main as run

    run()
