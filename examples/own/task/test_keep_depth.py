"""Laws of the task: equal seeds give equal results, and worlds and episodes are independent."""

from keep_depth import KeepDepth

from finssim.tasks import check_task


def test_the_task_is_sound():
    """Random actions reveal no mistake in observation, reward, start and end."""
    check_task(KeepDepth())
