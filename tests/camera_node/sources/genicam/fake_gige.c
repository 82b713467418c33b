// SPDX-License-Identifier: BSD-3-Clause
// Preloaded into a program with an ArvGvFakeCamera: gives it what Aravis's fake lacks, a clock that can be latched, and
// an address of its own on loopback, so that several fakes run on one machine without privileges.
//   FAKE_ADDRESS    IPv4 address of the interface lo as this program sees it
//   FAKE_OFFSET_NS  the camera's clock minus CLOCK_MONOTONIC when that is 0
//   FAKE_DRIFT      its relative drift
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <dlfcn.h>
#include <ifaddrs.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { LATCH = 0x0944, LATCHED_HIGH = 0x0948, LATCHED_LOW = 0x094c, LATCH_NOW = 2 };
typedef int (*write_register)(void *camera, uint32_t address, uint32_t value);

int getifaddrs(struct ifaddrs **list) {
    int failed = ((int (*)(struct ifaddrs **))dlsym(RTLD_NEXT, "getifaddrs"))(list);
    for (struct ifaddrs *entry = failed ? 0 : *list; entry; entry = entry->ifa_next)
        if (!strcmp(entry->ifa_name, "lo") && entry->ifa_addr && entry->ifa_addr->sa_family == AF_INET)
            inet_pton(AF_INET, getenv("FAKE_ADDRESS"), &((struct sockaddr_in *)entry->ifa_addr)->sin_addr);
    return failed;
}

int64_t fake_clock_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    double drift = atof(getenv("FAKE_DRIFT"));
    int64_t ns = now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
    return atoll(getenv("FAKE_OFFSET_NS")) + ns + (int64_t)(drift * (double)ns);
}

static void *aravis(const char *name) {
    return dlsym(dlopen("libaravis-0.8.so.0", RTLD_LAZY | RTLD_NOLOAD), name);
}

int arv_fake_camera_write_register(void *camera, uint32_t address, uint32_t value) {
    write_register set = (write_register)aravis("arv_fake_camera_write_register");
    if (address == LATCH && value & LATCH_NOW) {
        int64_t ns = fake_clock_ns();
        set(camera, LATCHED_HIGH, (uint32_t)(ns >> 32));
        set(camera, LATCHED_LOW, (uint32_t)ns);
    }
    return set(camera, address, value);
}
