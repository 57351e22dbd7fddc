"""Command line: commands made from the functions of the other packages."""


def main() -> None:
    """Run the command line and exit."""
    import gc

    gc.disable()  # until the command's modules are imported: garbage collection takes a sixth of that time
    from finssim.cli.commands import main as run

    run()
