"""Kernels of ray sensors for a GPU, where there is none to run them."""

import pytest
import warp as wp

from finssim.worlds import delivery, sensors


@pytest.mark.slow
@pytest.mark.parametrize("module", [delivery, sensors])
def test_every_kernel_compiles_for_cuda(module, tmp_path):
    """NVRTC, which needs no device, makes a binary of the module for a compute capability of 7.5."""
    wp.init()
    if wp.get_cuda_toolkit_version() is None:
        pytest.skip("this Warp has no CUDA compiler")
    wp.compile_aot_module(wp.get_module(module.__name__), arch=75, module_dir=tmp_path)
    assert [file.stat().st_size > 0 for file in tmp_path.glob("*.cubin")] == [True]
