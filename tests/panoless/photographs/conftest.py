"""Tests of photographs need what the extra `capture` installs."""

from importlib.util import find_spec

collect_ignore_glob = [] if find_spec("cv2") and find_spec("pycolmap") else ["test_*.py"]
