/* Preloaded into a writer: ends it with SIGKILL at the n-th call that changes a folder. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

static long left = -1;
static char folder[PATH_MAX];

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* Counts from here: the call number `at` in `where` is the last, 0 for none. */
void crash_at(long at, const char *where) {
    strncpy(folder, where, sizeof folder - 1);
    left = at;
}

static int is_inside(const char *path) {
    return left >= 0 && strncmp(path, folder, strlen(folder)) == 0;
}

static int is_inside_fd(int descriptor) {
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", descriptor);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return is_inside(path);
}

static void end(void) { kill(getpid(), SIGKILL); }

static int is_last(void) { return left > 0 && --left == 0; }

ssize_t write(int descriptor, const void *content, size_t size) {
    if (is_inside_fd(descriptor)) {
        if (is_last()) end();
        if (is_last()) {
            REAL(write)(descriptor, content, size / 2);
            end();
        }
    }
    return REAL(write)(descriptor, content, size);
}

int fsync(int descriptor) {
    if (is_inside_fd(descriptor) && is_last()) end();
    return REAL(fsync)(descriptor);
}

int rename(const char *from, const char *to) {
    if (is_inside(to) && is_last()) end();
    return REAL(rename)(from, to);
}

int link(const char *from, const char *to) {
    if (is_inside(to) && is_last()) end();
    return REAL(link)(from, to);
}

int unlink(const char *path) {
    if (is_inside(path) && is_last()) end();
    return REAL(unlink)(path);
}
