#include "kernel.h"

/* The hash of the sources that this library was built from: the loader refuses one that is older than they are. */
KERNEL const char *sfm_audit_sources(void) { return SFM_SOURCES; }
