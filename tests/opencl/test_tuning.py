"""Which tuning a device has: the default, or the one that was measured and stored."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

import lnocl
from lnocl.core.opencl import tuning as module
from lnocl.core.opencl.tuning import Tuning, candidates, in_words, measured, store, tune

KIB = 1024
SINGLE, DOUBLE = np.dtype(np.float32), np.dtype(np.float64)


def device(kind, local_kib, name="a device", units=56):
    return SimpleNamespace(
        type=kind,
        local_mem_size=local_kib * KIB,
        max_work_group_size=256,
        max_compute_units=units,
        name=name,
        platform=SimpleNamespace(name="a platform"),
        driver_version="1.0",
    )


CPU, GPU = (device(kind, 1024) for kind in (cl.device_type.CPU, cl.device_type.GPU))


@pytest.fixture(autouse=True)
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    return tmp_path


@pytest.mark.parametrize("local_kib", [256, 1024, 2048, 65536])
@pytest.mark.parametrize(
    ("grid", "dtype", "needed_kib"),
    [
        ((64, 64), np.float32, 8),
        ((1024, 1024), np.float32, 128),
        ((2048, 4096), np.float32, 256),
        ((8192, 64), np.float64, 1024),
        ((8192, 8192), np.float64, 1024),
    ],
)
def test_scratch_is_global_where_a_block_does_not_fit_in_local_memory(
    grid, dtype, needed_kib, local_kib
):
    tuning = tune(device(cl.device_type.CPU, local_kib), np.dtype(dtype), grid)
    assert tuning.block * np.dtype(dtype).itemsize == 32
    assert tuning.scratch_is_global == (needed_kib > local_kib)


@pytest.mark.parametrize(
    ("local_kib", "grid", "dtype", "block", "group", "is_global"),
    [
        (48, 64, SINGLE, 2, 16, False),  # too few blocks for all units, however small
        (48, 512, SINGLE, 4, 256, False),
        (48, 1024, SINGLE, 2, 256, False),
        (48, 2048, SINGLE, 2, 256, False),  # one group: blocks of 1 leave half of a sector unused
        (48, 4096, SINGLE, 1, 256, False),
        (48, 8192, SINGLE, 8, 256, True),
        (96, 8192, SINGLE, 1, 256, False),
        (48, 1024, DOUBLE, 1, 128, False),
        (48, 4096, DOUBLE, 8, 256, True),
        (128, 1024, SINGLE, 4, 256, False),
        (32, 1024, SINGLE, 2, 256, False),
        (32, 2048, SINGLE, 1, 256, False),
        (65536, 1024, SINGLE, 8, 256, False),
    ],
)
def test_blocks_of_a_gpu_lie_in_local_memory(local_kib, grid, dtype, block, group, is_global):
    gpu = device(cl.device_type.GPU, local_kib)
    tuning = Tuning(1, 8, group=256).fit(gpu, dtype, (grid, grid))
    found = tuning.block, tuning.group, tuning.scratch_is_global
    assert found == (block, group, is_global)
    sums = 2 * group * dtype.itemsize
    needed = 2 * grid * block * dtype.itemsize + sums
    assert tuning.local_bytes((grid, grid), 1, dtype) == needed
    assert is_global or needed <= local_kib * KIB


@pytest.mark.parametrize(
    ("local_kib", "most", "grid", "oversample", "dtype", "block", "items"),
    [
        (48, 1024, (64, 64), 1, SINGLE, 2, 8),  # as few passes with 8 points an item as with 16
        (48, 1024, (256, 256), 1, SINGLE, 2, 16),
        (48, 1024, (512, 512), 1, SINGLE, 4, 64),
        (48, 1024, (1024, 1024), 1, SINGLE, 4, 64),
        (48, 1024, (1024, 512), 1, SINGLE, 4, 64),
        (48, 1024, (1024, 1024), 1, DOUBLE, 2, 128),
        (48, 1024, (2048, 2048), 1, SINGLE, 2, 128),
        (48, 1024, (4096, 4096), 1, SINGLE, 2, 256),
        (48, 256, (4096, 4096), 1, SINGLE, 1, 256),  # where groups have 256 items at most
        (48, 1024, (768, 768), 1, SINGLE, 2, 64),  # 12 points an item
        (48, 1024, (512, 512), 2, SINGLE, 4, 32),
    ],
)
def test_lines_of_a_gpu_lie_in_registers(local_kib, most, grid, oversample, dtype, block, items):
    gpu = device(cl.device_type.GPU, local_kib)
    gpu.max_work_group_size = most
    tuning = tune(gpu, dtype, grid, oversample)
    assert tuning.points
    assert (tuning.block, tuning.group // tuning.block) == (block, items)
    exchanged = max(max(grid) * 17 // 16 * block, 2 * grid[0])
    needed = (exchanged + 2 * tuning.group) * dtype.itemsize
    assert tuning.local_bytes(grid, oversample, dtype) == needed <= local_kib * KIB


@pytest.mark.parametrize(
    ("grid", "oversample", "has_turns", "dtype"),
    [
        ((1152, 1152), 1, False, SINGLE),  # an odd factor 9 leaves radices of 2
        ((64, 2048), 1, False, SINGLE),  # too lopsided
        ((8192, 8192), 1, False, SINGLE),  # too long for local memory
        ((4096, 4096), 1, False, DOUBLE),
        ((512, 512), 1, True, SINGLE),  # turned
        ((8, 8), 4, False, SINGLE),
    ],
)
def test_other_lines_lie_in_the_scratch(grid, oversample, has_turns, dtype):
    gpu = device(cl.device_type.GPU, 48)
    gpu.max_work_group_size = 1024
    found = tune(gpu, dtype, grid, oversample, has_turns)
    assert found == Tuning(1, 8, 256).fit(gpu, dtype, grid, oversample, has_turns)
    assert not found.points


def test_a_group_needs_room_for_its_sums_beside_the_block():
    gpu = device(cl.device_type.GPU, 64)  # as large as the block alone
    assert tune(gpu, SINGLE, (8192, 8192)).scratch_is_global
    gpu.local_mem_size += 2 * 256 * 4
    assert not tune(gpu, SINGLE, (8192, 8192)).scratch_is_global


def test_each_unit_of_a_gpu_has_a_block():
    """Blocks are smaller than local memory allows where there are fewer of them than units."""
    gpu = device(cl.device_type.GPU, 1024, units=132)
    cut = Tuning(1, 8, 256)
    blocks = [cut.fit(gpu, SINGLE, (n, n)).block for n in (256, 1024, 2048, 4096)]
    assert blocks == [2, 2, 4, 8]
    assert [tune(gpu, SINGLE, (n, n)).block for n in (256, 1024, 2048)] == [2, 2, 2]


def test_the_default_is_the_first_candidate():
    assert tune(CPU, SINGLE, (512, 512)) == candidates(CPU, SINGLE)[0]
    assert [in_words(each, SINGLE) for each in candidates(CPU, SINGLE)] == [
        "vectors of 256 bits",
        "vectors of 512 bits",
    ]
    assert in_words(candidates(CPU, DOUBLE)[0], DOUBLE) == "vectors of 256 bits"
    assert [in_words(each, SINGLE) for each in candidates(GPU, SINGLE)] == [
        *(f"{n} points a work-item in registers at most" for n in (16, 8)),
        *(f"work-groups of {n} and blocks of {block}" for block in (8, 2) for n in (256, 128, 64)),
    ]
    assert in_words(candidates(GPU, DOUBLE)[0], DOUBLE).startswith("8 points")


@pytest.mark.parametrize("given", [CPU, GPU], ids=["CPU", "GPU"])
def test_measured_tuning_applies_to_its_device_and_precision_only(given):
    fastest = candidates(given, SINGLE)[1]
    assert measured(given, SINGLE) is None
    assert store(given, {SINGLE: fastest}).is_file()
    assert (
        measured(given, SINGLE)
        == fastest
        == replace(tune(given, SINGLE, (1024, 1024)), block=fastest.block, group=fastest.group)
    )
    assert measured(given, DOUBLE) is None
    assert measured(device(given.type, 1024, "another"), SINGLE) is None
    other = device(given.type, 1024, "another")
    store(other, {SINGLE: candidates(other, SINGLE)[0]})
    assert measured(given, SINGLE) == fastest


@pytest.mark.parametrize("grid", [(2, 8192), (48, 80), (112, 64), (1024, 1024)])
def test_blocks_fit_the_grid(grid):
    store(CPU, {SINGLE: candidates(CPU, SINGLE)[1]})
    tuning = tune(CPU, SINGLE, grid)
    for n in grid:
        assert n // module.odd_part(n) % (2 * tuning.block) == 0
    assert tuning.lanes == tuning.block <= 16


@pytest.mark.parametrize("cut", [0, 40, -1])
def test_a_damaged_file_is_not_used(cut):
    file = store(CPU, {SINGLE: candidates(CPU, SINGLE)[1]})
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.warns(lnocl.LnoclWarning, match="is damaged, and is not used") as said:
        assert measured(CPU, SINGLE) is None
    assert measured(CPU, SINGLE) is None
    assert len(said) == 1
    store(CPU, {SINGLE: candidates(CPU, SINGLE)[1]})
    assert measured(CPU, SINGLE) == candidates(CPU, SINGLE)[1]


@pytest.mark.parametrize("place", ["folder", "file"])
def test_tuning_that_cannot_be_stored_raises_a_file_error(folder, monkeypatch, place):
    if place == "file":
        module._file(CPU).mkdir()
    else:
        (folder / "file").touch()
        monkeypatch.setenv("POCL_CACHE_DIR", str(folder / "file" / "folder"))
    with pytest.raises(lnocl.FileError, match=r"cannot be written to .*set POCL_CACHE_DIR"):
        store(CPU, {SINGLE: candidates(CPU, SINGLE)[1]})


def test_a_tuning_that_is_no_candidate_is_not_used():
    store(CPU, {SINGLE: replace(candidates(CPU, SINGLE)[1], lanes=3)})
    assert measured(CPU, SINGLE) is None
