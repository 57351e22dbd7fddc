"""The task is sound: equal seeds are equal, no world knows of another, no episode of the one before."""

from keep_depth import KeepDepth

from finssim.tasks import check_task


def test_the_task_is_sound():
    """Random actions find no mistake in observation, reward, start and end."""
    check_task(KeepDepth())
