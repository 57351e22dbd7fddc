"""Kernels of ray sensors compile for a GPU on machines without one."""

import importlib
import pkgutil

import pytest
import warp as wp

import finssim.extensions.perception

NAMES = [
    f"finssim.extensions.perception.{module.name}"
    for module in pkgutil.iter_modules(finssim.extensions.perception.__path__)
]


@pytest.mark.slow
def test_every_kernel_compiles_for_cuda(tmp_path):
    """NVRTC, which needs no device, compiles each module with kernels to PTX for compute capability 7.5."""
    wp.init()
    if wp.get_cuda_toolkit_version() is None:
        pytest.skip("this Warp has no CUDA compiler")
    compiled = {}
    for name in NAMES:
        importlib.import_module(name)
        module = wp.get_module(name)
        if module.kernels:
            wp.compile_aot_module(module, arch=75, module_dir=tmp_path / name, use_ptx=True)
            compiled[name] = [file.stat().st_size > 0 for file in (tmp_path / name).glob("*.ptx")]
    assert compiled == {
        "finssim.extensions.perception.delivery": [True],
        "finssim.extensions.perception.cameras": [True],
        "finssim.extensions.perception.rangers": [True],
        "finssim.extensions.perception.ray_batch": [True],
        "finssim.extensions.perception.sonars": [True],
        "finssim.extensions.perception.sight": [True],
    }
