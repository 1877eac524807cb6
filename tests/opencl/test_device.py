"""Choosing a device, and what is said where there is none or it cannot do what is asked."""

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest
from scenes import blur, paper
from scipy.special import kl_div

import lnocl
from lnocl import process
from lnocl.core.engines import opencl
from lnocl.core.opencl import device, program, sharing
from lnocl.core.opencl.tuning import Tuning
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import MIN_MODEL

GPU = SimpleNamespace(name="Fast GPU", type=cl.device_type.GPU)
CPU = SimpleNamespace(name="Slow CPU", type=cl.device_type.CPU)
SECOND_CPU = SimpleNamespace(name="Other CPU", type=cl.device_type.CPU)


@pytest.fixture
def machine(monkeypatch):
    """A machine with two platforms: one with two CPUs, one with a GPU."""
    platforms = [
        SimpleNamespace(name="Portable", get_devices=lambda: [CPU, SECOND_CPU]),
        SimpleNamespace(name="Vendor", get_devices=lambda: [GPU]),
    ]
    for platform in platforms:
        for each in platform.get_devices():
            monkeypatch.setattr(each, "platform", platform, raising=False)
            monkeypatch.setattr(each, "driver_version", "1", raising=False)
    monkeypatch.setattr(cl, "get_platforms", lambda: platforms)
    monkeypatch.delenv("PYOPENCL_CTX", raising=False)
    return platforms


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        (None, GPU),
        ("0", CPU),
        ("0:1", SECOND_CPU),
        ("portable", CPU),
        ("PORT:other", SECOND_CPU),
        ("1:0", GPU),
        ("vendor:gpu", GPU),
    ],
)
def test_choose(machine, spec, expected):
    assert device.choose(spec).device is expected


def test_a_gpu_that_is_taken_unasked_is_named_once_and_the_cpu_beside_it(machine, caplog):
    caplog.set_level("INFO")
    device._tell.cache_clear()
    for spec in (None, None, "1:0", "0:0"):
        device.tell(device.choose(spec))
    assert caplog.messages == [
        "Fast GPU (Vendor, 1) is taken, the first GPU; device 0:0 takes the CPU, which may be "
        "faster than a small GPU: lnocl bench times either"
    ]
    machine.pop(0)
    assert device.choose().instead is None


def test_first_cpu_where_there_is_no_gpu(machine):
    machine.pop()
    assert device.choose().device is CPU
    assert device.choose().reason == "the first CPU"


def test_environment_decides_where_nothing_is_asked_for(machine, monkeypatch):
    monkeypatch.setenv("PYOPENCL_CTX", "0:1")
    assert device.choose().device is SECOND_CPU
    assert "PYOPENCL_CTX" in device.choose().reason
    assert device.choose("1").device is GPU


@pytest.mark.parametrize("threads", ["-1", "0", "4097", "9" * 20, "9" * 5000, "1.5", "all"])
def test_numbers_of_threads_that_end_pocl_are_refused_before_it_is_loaded(monkeypatch, threads):
    monkeypatch.setattr(cl, "get_platforms", lambda: pytest.fail("it is loaded"))
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", threads)
    with pytest.raises(lnocl.InputError) as caught:
        device.choose()
    assert str(caught.value) == (
        f"POCL_MAX_PTHREAD_COUNT is '{threads}'; set it to a whole number from 1 to 4096, or unset "
        "it for a thread a core"
    )


@pytest.mark.parametrize("threads", ["1", "4096", " 2 ", ""])
def test_other_numbers_of_threads_are_taken(machine, monkeypatch, threads):
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", threads)
    assert device.choose().device is GPU


@pytest.mark.parametrize("spec", ["2", "0:2", "nosuch", "vendor:cpu", "", ":0"])
def test_unknown_device_is_refused_with_a_list_of_devices(machine, spec):
    with pytest.raises(
        lnocl.InputError, match=r"fits no OpenCL device; give one of these: 0:0 for Slow CPU"
    ) as error:
        device.choose(spec)
    assert "\n" not in str(error.value)


def test_specification_finds_the_device_again(machine):
    machine.insert(0, SimpleNamespace(name="Empty", get_devices=list))
    for each in (CPU, SECOND_CPU, GPU):
        assert device.choose(device.spec_of(each)).device is each


def test_workers_take_the_gpus_of_a_platform_in_turn(machine, monkeypatch):
    second = SimpleNamespace(name="Fast GPU", type=GPU.type, platform=machine[1])
    machine[1].get_devices = lambda: [GPU, second]
    again = SimpleNamespace(name="Same GPU", get_devices=lambda: [other])
    other = SimpleNamespace(name="Fast GPU", type=GPU.type, platform=again)
    machine.append(again)
    claimed = []
    monkeypatch.setattr(sharing, "claim", lambda n: claimed.append(n) or 1)
    assert device.choose().device is GPU
    assert not claimed
    monkeypatch.setattr(process, "is_worker", True)
    assert device.choose().device is second
    assert device.choose().reason == "GPU 2 of 2, shared among processes"
    assert claimed == [2, 2]
    assert device.choose("1:0").device is GPU
    machine[1].get_devices = lambda: [GPU]
    assert device.choose().device is GPU


CLAIM = """
import sys
from lnocl.core.opencl import sharing
print(sharing.claim(2), sharing.claim(2), flush=True)
sys.stdin.read()
"""


@pytest.mark.exhaustive
def test_processes_claim_devices_that_the_fewest_others_have(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    started = []

    def claimed():
        pipe = subprocess.PIPE
        started.append(subprocess.Popen([sys.executable, "-c", CLAIM], stdin=pipe, stdout=pipe))
        return started[-1].stdout.readline().split()

    try:
        assert [claimed() for _ in range(3)] == [[b"0"] * 2, [b"1"] * 2, [b"0"] * 2]
        started[1].kill()
        started[1].wait()
        assert claimed() == [b"1"] * 2
    finally:
        for each in started:
            each.kill()
            each.communicate()


def test_a_folder_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    (tmp_path / f"lnocl-devices-{os.getuid()}").write_text("")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(lnocl.DeviceError, match=r"devices cannot be shared .*; give device"):
        sharing.claim.__wrapped__(2)


def test_no_platform(monkeypatch):
    def none():
        raise cl.LogicError("clGetPlatformIDs", -1001, "")

    monkeypatch.setattr(cl, "get_platforms", none)
    with pytest.raises(
        lnocl.DeviceError,
        match=r"no OpenCL device was found; install the driver",
    ):
        device.choose()


@pytest.mark.exhaustive
def test_no_double_precision(monkeypatch):
    monkeypatch.setattr(program, "has_double", lambda device: False)
    observation = lnocl.Observation(np.ones((16, 32)), np.ones((1, 1)))
    with pytest.raises(lnocl.DeviceError, match="has no double precision; take precision single"):
        paper(observation, precision="double", n_iter=1)
    paper(observation, precision="single", n_iter=1)


@pytest.mark.parametrize("limit", ["global_mem_size", "max_mem_alloc_size"])
def test_too_little_memory_is_refused_before_anything_is_allocated(monkeypatch, limit):
    found = device.choose().device
    monkeypatch.setattr(opencl.Memory, "allocate", lambda *_, **__: pytest.fail("allocated"))
    monkeypatch.setattr(cl.Device, limit, 20_000)
    mask = np.arange(16 * 32).reshape(16, 32) == 100
    observation = lnocl.Observation(np.ones((2, 16, 32)), np.ones((16, 32)), mask=mask)
    many = opencl.Scene(observation, [(i, i) for i in range(8)], Penalty(mu=1e-6))
    with pytest.raises(lnocl.DeviceError, match=r"the scene needs \d+ MiB, .* for star_images"):
        opencl.OpenCLEngine(many, "single", device.spec_of(found), 10)


@pytest.mark.parametrize(
    ("shape", "tuning"),
    [
        ((16, 32), None),
        pytest.param((64, 32), Tuning(4, 16, scratch_is_global=True), marks=pytest.mark.exhaustive),
    ],
)
def test_memory_estimate_equals_the_size_of_the_buffers(shape, tuning, caplog):
    """With scratch in local memory, of which 32 KiB will do, and with scratch in global memory."""
    caplog.set_level("DEBUG", "lnocl")
    observation = lnocl.Observation(np.ones((2, *shape)), np.ones((1, 1)))
    engine = opencl.OpenCLEngine(opencl.Scene(observation), "single", None, 10, tuning)
    engine.extended()  # waits for the device
    launcher = engine._launcher
    own = {id(each): each for each in launcher.own.values()}  # the same roots have several names
    held = [*engine._memory.buffers.values(), *own.values()]
    if tuning is None:
        held.remove(launcher.own["scratch"])
    assert engine.bytes_needed == sum(buffer.size for buffer in held)
    (message,) = caplog.messages
    start = f"{engine.name}: the scene takes {engine.bytes_needed / 2**20:.1f} MiB there, and up to"
    assert message.startswith(start)


@pytest.mark.exhaustive
def test_plain_arrays_need_no_astropy_and_the_reference_engine_no_opencl():
    code = (
        "import sys; sys.modules['pyopencl'] = None\n"
        "import numpy, lnocl\n"
        "obs = lnocl.Observation(numpy.ones((2, 8, 8)), numpy.ones((1, 1)), background=1.0,"
        " read_noise=[1, 2], exposure=[1, 2], offsets=[(0, 0), (1, 0.5)])\n"
        "assert not [name for name in sys.modules if name.startswith('astropy')]\n"
        "print(lnocl.deconvolve(obs, n_iter=1, stop=None, engine='numpy').device)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "numpy\n"


def test_values_too_large_for_single_precision_are_refused():
    observation = lnocl.Observation(np.ones((16, 32)), np.ones((1, 1)), mask=np.eye(16, 32) > 0)
    given = {"mu": 1e-6, "initial_star_fluxes": [1e300, 1.0]}
    with pytest.raises(lnocl.InputError, match=r"star fluxes as large as .* held in float32"):
        paper(observation, [(1, 2), (7, 5)], n_iter=1, **given)


@pytest.mark.parametrize("engine", ["numpy", "opencl"])
@pytest.mark.filterwarnings("ignore:.*psf pixels are negative")
def test_objective_is_finite_where_the_model_is_negative_and_there_are_counts(engine):
    psf = np.array([[-1.0, 3.0, -1.0]])
    observation = lnocl.Observation(np.full((16, 32), 3.0), psf)
    start = np.ones((16, 32))
    start[2, 5] = 50.0
    result = paper(observation, n_iter=3, initial_extended=start, engine=engine)
    model = np.maximum(blur(start, psf), 4.0 * MIN_MODEL)  # images of mean 3 are scaled by 4
    expected = kl_div(3.0, model).sum()
    assert result.history["objective"][0] == pytest.approx(expected, rel=1e-6)
    assert np.isfinite(result.history["objective"]).all()
    assert np.isfinite(result.extended).all()
