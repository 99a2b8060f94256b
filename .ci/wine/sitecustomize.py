"""Keep the module platform from asking WMI, which Wine lacks. Imported by Python when it starts."""

import platform


def _absent(*_: object) -> None:
    raise OSError("Wine has no WMI")


platform._wmi_query = _absent
