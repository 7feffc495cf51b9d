"""Videos of whole motions."""

from typing import Any

import gymnasium as gym


class RecordVideo(gym.wrappers.RecordVideo):
    """Gymnasium's `RecordVideo`, which keeps one frame of each step, with every frame of a primitive.

    The environment is made with ``render_mode="rgb_array_list"``. Needs moviepy.

    Raises:
        ValueError: for another render mode.
    """

    def __init__(self, env: gym.Env[Any, Any], *args: Any, **kwargs: Any) -> None:
        if env.render_mode != "rgb_array_list":
            raise ValueError(f'render_mode must be "rgb_array_list", not {env.render_mode!r}')
        super().__init__(env, *args, **kwargs)

    def _capture_frame(self) -> None:
        frames: Any = self.env.render()
        self.render_history += frames
        self.recorded_frames += frames
