// SPDX-License-Identifier: BSD-3-Clause
// Preloaded into a program: its CLOCK_REALTIME is the machine's plus the nanoseconds in the file $CLOCK_STEP_FILE.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static const volatile int64_t *step;
static int (*real)(clockid_t, struct timespec *);

__attribute__((constructor)) static void open_step(void) {
    real = dlsym(RTLD_NEXT, "clock_gettime");
    int file = open(getenv("CLOCK_STEP_FILE"), O_RDONLY);
    step = mmap(0, sizeof *step, PROT_READ, MAP_SHARED, file, 0);
    if (step == MAP_FAILED) abort();
}

int clock_gettime(clockid_t clock, struct timespec *to) {
    if (!real) real = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real(clock, to);
    if (failed || clock != CLOCK_REALTIME || !step) return failed;
    int64_t ns = to->tv_sec * INT64_C(1000000000) + to->tv_nsec + *step;
    to->tv_sec = ns / 1000000000, to->tv_nsec = ns % 1000000000;
    return 0;
}

int gettimeofday(struct timeval *restrict to, void *restrict zone) {
    (void)zone;
    struct timespec now;
    int failed = clock_gettime(CLOCK_REALTIME, &now);
    to->tv_sec = now.tv_sec, to->tv_usec = now.tv_nsec / 1000;
    return failed;
}
