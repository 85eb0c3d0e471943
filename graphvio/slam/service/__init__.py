"""The odometry as a gRPC service, described by ``graphvio.proto``; needs the optional part ``serve``."""
