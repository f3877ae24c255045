"""The one place that imports Open3D: late, because it takes seconds, and with an error a user can act on."""

from types import ModuleType

from lidarflow.errors import InstallError

DEBIAN_PACKAGES = "libusb-1.0-0 libegl1 libgl1 libx11-6 libudev1 libidn2-0"


def open3d() -> ModuleType:
    """The open3d module; InstallError where it, or a system library it links to, is missing."""
    try:
        import open3d as module
    except (ImportError, OSError) as error:
        reason = " ".join(str(error).split())
        raise InstallError(
            f"Open3D cannot be imported ({reason}); on Debian or Ubuntu: apt-get install {DEBIAN_PACKAGES}"
        ) from error
    return module
