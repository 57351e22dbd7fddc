"""Laws of the study: existing results are kept, and equal seeds give equal results."""

import study as module


def test_a_study_continues_with_what_it_has(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "SEEDS", (1,))
    monkeypatch.setattr(module, "PLANTS", ("nominal",))
    first = module.study(tmp_path, trials=1)
    made = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert module.study(tmp_path, trials=1) == first and first["nominal"]["mean"] > 0.0
    assert made == {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
