"""Tables of logs as text, and the trials read from them."""

from finssim.trials.importers.dispatch import read_trials


def csv(path, /, **columns):
    """Write columns as a table and return its path."""
    cells = [[str(value) for value in values] for values in columns.values()]
    lines = [",".join(columns), *(",".join(row) for row in zip(*cells, strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


def read(folder, columns, text=None, name="log.csv"):
    """Return the trial of a table of columns, with a map if a text is given."""
    csv(folder / name, **columns)
    if text is not None:
        (folder / "map.yaml").write_text(text)
    (trial,) = read_trials([folder / name], column_map=None if text is None else folder / "map.yaml")
    return trial


def codes(trial):
    """Return the codes of a trial's findings."""
    return {item.code for item in trial.findings}
