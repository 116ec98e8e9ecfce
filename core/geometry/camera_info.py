"""A calibrated camera from ROS's camera_info YAML (camera_calibration_parsers)."""

from pathlib import Path

import yaml

from nerf2real.core.geometry.cameras import Camera


def read_camera_info(path: Path) -> Camera:
  """Reads a camera_info YAML as ROS and `real.camera.calibration` write it.

  Raises:
    ValueError: The file is none, or of another distortion model.
  """
  try:
    info = yaml.safe_load(Path(path).read_text())
    matrix, coefficients = info["camera_matrix"]["data"], info["distortion_coefficients"]["data"]
    size = int(info["image_width"]), int(info["image_height"])
    model = info["distortion_model"]
    k1, k2, p1, p2, *rest = (float(c) for c in [*coefficients, 0, 0, 0, 0][:5])
    camera = Camera.from_opencv(*size, matrix, (k1, k2, p1, p2))
  except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
    reason = str(error).splitlines()[0]  # YAML's errors quote the file
    raise ValueError(
      f"{path} is no camera_info YAML ({reason}): write one with launch/calibrate_camera.py or "
      "ROS's camera_calibration."
    ) from error
  if model != "plumb_bob" or any(rest):
    raise ValueError(
      f"{path} has the distortion {model!r} with k3 = {rest}, expected plumb_bob with k3 = 0: "
      "calibrate again with two radial terms."
    )
  return camera
