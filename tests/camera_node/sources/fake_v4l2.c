// SPDX-License-Identifier: BSD-3-Clause
// Preloaded into a program: the file $FAKE_V4L2 behaves like a V4L2 camera of 100 frames a second. The structures and
// requests are those of the kernel's header. The file itself is the memory of the buffers, so that mmap needs no help.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <linux/videodev2.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

enum { BUFFERS = 4, SIZE = 1 << 20, PERIOD_NS = 10000000 };

static struct control {
    unsigned id, type;
    const char *name;
    int low, high, step, value;
    unsigned flags;
    const char *entries[4];
} controls[] = {
    {V4L2_CID_BRIGHTNESS, V4L2_CTRL_TYPE_INTEGER, "Brightness", 0, 255, 1, 128, 0, {0}},
    {V4L2_CID_GAIN, V4L2_CTRL_TYPE_INTEGER, "Gain", 0, 100, 1, 4, 0, {0}},
    {V4L2_CID_POWER_LINE_FREQUENCY, V4L2_CTRL_TYPE_MENU, "Power Line Frequency", 0, 2, 1, 1, 0, {"Disabled", "50 Hz", "60 Hz"}},
    {V4L2_CID_CAMERA_CLASS, V4L2_CTRL_TYPE_CTRL_CLASS, "Camera Controls", 0, 0, 0, 0, V4L2_CTRL_FLAG_READ_ONLY, {0}},
    {V4L2_CID_EXPOSURE_AUTO, V4L2_CTRL_TYPE_MENU, "Auto Exposure", 0, 3, 1, 3, 0, {0, "Manual Mode", 0, "Aperture Priority Mode"}},
    {V4L2_CID_EXPOSURE_ABSOLUTE, V4L2_CTRL_TYPE_INTEGER, "Exposure Time, Absolute", 1, 5000, 1, 100, 0, {0}},
    {V4L2_CID_FOCUS_ABSOLUTE, V4L2_CTRL_TYPE_INTEGER, "Focus, Absolute", 0, 250, 5, 0, 0, {0}},
    {V4L2_CID_FOCUS_AUTO, V4L2_CTRL_TYPE_BOOLEAN, "Focus, Automatic Continuous", 0, 1, 1, 1, 0, {0}},
};
enum { N_CONTROLS = sizeof controls / sizeof *controls };
static struct v4l2_pix_format format = {.width = 640, .height = 480, .pixelformat = V4L2_PIX_FMT_GREY};
static int queued[BUFFERS], n_queued;
static unsigned sequence;

static int fail(int error) {
    errno = error;
    return -1;
}

static struct control *find(unsigned id) {
    for (int k = 0; k < N_CONTROLS; k++)
        if (controls[k].id == id) return &controls[k];
    return 0;
}

static int query(struct v4l2_query_ext_ctrl *to) {
    unsigned wanted = to->id & ~(V4L2_CTRL_FLAG_NEXT_CTRL | V4L2_CTRL_FLAG_NEXT_COMPOUND);
    for (int k = 0; k < N_CONTROLS; k++) {
        struct control *c = &controls[k];
        if (to->id & V4L2_CTRL_FLAG_NEXT_CTRL ? c->id <= wanted : c->id != wanted) continue;
        memset(to, 0, sizeof *to);
        to->id = c->id, to->type = c->type, to->flags = c->flags;
        to->minimum = c->low, to->maximum = c->high, to->step = (unsigned)c->step, to->default_value = c->value;
        strncpy(to->name, c->name, sizeof to->name - 1);
        return 0;
    }
    return fail(EINVAL);
}

static int menu(struct v4l2_querymenu *to) {
    struct control *c = find(to->id);
    if (!c || to->index > 3 || !c->entries[to->index]) return fail(EINVAL);
    strncpy((char *)to->name, c->entries[to->index], sizeof to->name - 1);
    return 0;
}

static int set_or_get(struct v4l2_ext_controls *all, int set) {
    struct v4l2_ext_control *one = all->controls;
    struct control *c = all->which == V4L2_CTRL_WHICH_CUR_VAL && all->count == 1 ? find(one->id) : 0;
    if (!c) return fail(EINVAL);
    if (!set) return one->value = c->value, 0;
    if (one->value < c->low || one->value > c->high) return fail(ERANGE);
    if (c->id == V4L2_CID_EXPOSURE_ABSOLUTE && find(V4L2_CID_EXPOSURE_AUTO)->value != 1) return fail(EACCES);
    return c->value = one->value, 0;
}

static int list_sizes(struct v4l2_frmsizeenum *to) {
    if (to->index > 1 || to->pixel_format != V4L2_PIX_FMT_GREY) return fail(EINVAL);
    to->type = V4L2_FRMSIZE_TYPE_DISCRETE;
    to->discrete.width = to->index ? 320 : 640, to->discrete.height = to->index ? 240 : 480;
    return 0;
}

static int list_intervals(struct v4l2_frmivalenum *to) {
    if (to->index > 1) return fail(EINVAL);
    to->type = V4L2_FRMIVAL_TYPE_DISCRETE;
    to->discrete.numerator = 1, to->discrete.denominator = to->index ? 30 : 100;
    return 0;
}

static int set_format(struct v4l2_format *to) {
    if (to->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return fail(EINVAL);
    if (to->fmt.pix.width == 320 || to->fmt.pix.width == 640) format.width = to->fmt.pix.width;
    format.height = format.width * 3 / 4, format.bytesperline = format.width;
    format.sizeimage = format.width * format.height, format.field = V4L2_FIELD_NONE;
    to->fmt.pix = format;
    return 0;
}

static int describe(struct v4l2_buffer *to) {
    if (to->index >= BUFFERS) return fail(EINVAL);
    to->length = SIZE, to->m.offset = to->index * SIZE, to->memory = V4L2_MEMORY_MMAP;
    return 0;
}

// The next frame: all pixels are the exposure in units of 100 us, and the stamp is its time.
static int dequeue(int file, struct v4l2_buffer *to) {
    if (!n_queued) return fail(EAGAIN);
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    now.tv_nsec = (now.tv_nsec / PERIOD_NS + 1) * PERIOD_NS;
    if (now.tv_nsec >= 1000000000) now.tv_sec++, now.tv_nsec -= 1000000000;
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &now, 0);
    to->index = (unsigned)queued[0];
    memmove(queued, queued + 1, sizeof *queued * (size_t)--n_queued);
    describe(to);
    to->flags = V4L2_BUF_FLAG_MAPPED | V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC, to->field = V4L2_FIELD_NONE;
    to->bytesused = format.sizeimage, to->sequence = sequence++;
    to->timestamp.tv_sec = now.tv_sec, to->timestamp.tv_usec = now.tv_nsec / 1000;
    static unsigned char image[640 * 480];
    memset(image, find(V4L2_CID_EXPOSURE_ABSOLUTE)->value, format.sizeimage);
    return pwrite(file, image, format.sizeimage, to->m.offset) == (ssize_t)format.sizeimage ? 0 : fail(EIO);
}

static int answer(int file, unsigned long request, void *argument) {
    switch (request) {
    case VIDIOC_QUERYCAP: {
        struct v4l2_capability *to = argument;
        memset(to, 0, sizeof *to);
        strcpy((char *)to->driver, "fake"), strcpy((char *)to->card, "Fake Camera");
        to->device_caps = V4L2_CAP_VIDEO_CAPTURE | V4L2_CAP_STREAMING;
        to->capabilities = to->device_caps | V4L2_CAP_DEVICE_CAPS;
        return 0;
    }
    case VIDIOC_ENUM_FMT: {
        struct v4l2_fmtdesc *to = argument;
        if (to->index || to->type != V4L2_BUF_TYPE_VIDEO_CAPTURE) return fail(EINVAL);
        return to->pixelformat = V4L2_PIX_FMT_GREY, 0;
    }
    case VIDIOC_ENUM_FRAMESIZES: return list_sizes(argument);
    case VIDIOC_ENUM_FRAMEINTERVALS: return list_intervals(argument);
    case VIDIOC_QUERY_EXT_CTRL: return query(argument);
    case VIDIOC_QUERYMENU: return menu(argument);
    case VIDIOC_G_EXT_CTRLS: return set_or_get(argument, 0);
    case VIDIOC_S_EXT_CTRLS: return set_or_get(argument, 1);
    case VIDIOC_G_INPUT: return *(int *)argument = 0, 0;
    case VIDIOC_S_INPUT: return 0;
    case VIDIOC_G_FMT:
    case VIDIOC_TRY_FMT:
    case VIDIOC_S_FMT: return set_format(argument);
    case VIDIOC_G_PARM:
    case VIDIOC_S_PARM: {
        struct v4l2_streamparm *to = argument;
        to->parm.capture.capability = V4L2_CAP_TIMEPERFRAME;
        to->parm.capture.timeperframe = (struct v4l2_fract){1, 100};
        return 0;
    }
    case VIDIOC_REQBUFS: {
        struct v4l2_requestbuffers *to = argument;
        n_queued = 0;
        return to->count = to->count > BUFFERS ? BUFFERS : to->count, 0;
    }
    case VIDIOC_QUERYBUF: return describe(argument);
    case VIDIOC_QBUF: return queued[n_queued++] = (int)((struct v4l2_buffer *)argument)->index, 0;
    case VIDIOC_DQBUF: return dequeue(file, argument);
    case VIDIOC_STREAMON: return 0;
    case VIDIOC_STREAMOFF: return n_queued = 0, 0;
    default: return fail(ENOTTY);
    }
}

int ioctl(int file, unsigned long request, ...) {
    va_list arguments;
    va_start(arguments, request);
    void *argument = va_arg(arguments, void *);
    va_end(arguments);
    struct stat own, fake;
    if (!fstat(file, &own) && !stat(getenv("FAKE_V4L2"), &fake) && own.st_ino == fake.st_ino && own.st_dev == fake.st_dev)
        return answer(file, request & 0xffffffff, argument);
    return ((int (*)(int, unsigned long, ...))dlsym(RTLD_NEXT, "ioctl"))(file, request, argument);
}
