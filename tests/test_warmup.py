"""After the warm-up, the first frameset finds every kernel compiled."""

from graphvio.config import Config
from graphvio.events import FrameSet
from graphvio.frontend import cost, ransac, refinement, resection, stereo
from graphvio.frontend.visual import VisualFrontend
from graphvio.simulation import default_rig, make_simulator
from graphvio.warmup import warm_up


def test_no_kernel_is_compiled_after_the_warm_up() -> None:
    kernels = [
        value
        for module in (cost, ransac, refinement, resection, stereo)
        for value in vars(module).values()
        if hasattr(value, "signatures")
    ]
    simulator = make_simulator("room", duration_s=0.2)
    config = Config()
    warm_up(default_rig(), config)
    before = [list(kernel.signatures) for kernel in kernels]
    frontend = VisualFrontend(simulator.rig, config)
    for k in range(3):
        result = frontend.process(FrameSet(k, simulator.frameset(k).images), lambda _: None)
    frontend.close()
    assert result.motion is not None
    assert [list(kernel.signatures) for kernel in kernels] == before
