"""The encoder: from posed pictures to a .kpc file. It needs PyTorch, PyAV and numba (the extra
`kpc[encoder]`).
"""
