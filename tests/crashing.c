/* Preloaded into a writer: ends it with SIGKILL at the n-th call that changes a folder, or writes
   down the calls. Threads may call at once. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

static long left = -1;
static int record = -1;
static char folder[PATH_MAX];

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* Counts from here: the call number `at` in `where` is the last, 0 for none. */
void crash_at(long at, const char *where) {
    strncpy(folder, where, sizeof folder - 1);
    left = at;
}

/* Writes a line for every call from here to an open file. */
void record_to(int descriptor) { record = descriptor; }

static int is_inside(const char *path) {
    return left >= 0 && strncmp(path, folder, strlen(folder)) == 0;
}

static int path_of(int descriptor, char *path) {
    char name[64];
    snprintf(name, sizeof name, "/proc/self/fd/%d", descriptor);
    ssize_t length = readlink(name, path, PATH_MAX - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return is_inside(path);
}

static void note(const char *call, const char *path) {
    if (record >= 0) dprintf(record, "%s %s\n", call, path + strlen(folder));
}

static void end(void) {
    kill(getpid(), SIGKILL);
    pause();
}

static int is_last(void) {
    long now = __atomic_load_n(&left, __ATOMIC_SEQ_CST);
    return now > 0 && __atomic_sub_fetch(&left, 1, __ATOMIC_SEQ_CST) == 0;
}

ssize_t write(int descriptor, const void *content, size_t size) {
    char path[PATH_MAX];
    if (descriptor != record && path_of(descriptor, path)) {
        note("write", path);
        if (is_last()) end();
        if (is_last()) {
            REAL(write)(descriptor, content, size / 2);
            end();
        }
    }
    return REAL(write)(descriptor, content, size);
}

int fsync(int descriptor) {
    char path[PATH_MAX];
    if (path_of(descriptor, path)) {
        note("fsync", path);
        if (is_last()) end();
    }
    return REAL(fsync)(descriptor);
}

static void change(const char *call, const char *path) {
    if (!is_inside(path)) return;
    note(call, path);
    if (is_last()) end();
}

int rename(const char *from, const char *to) {
    change("rename", to);
    return REAL(rename)(from, to);
}

int link(const char *from, const char *to) {
    change("link", to);
    return REAL(link)(from, to);
}

int linkat(int there, const char *from, int here, const char *to, int flags) {
    change("link", to);
    return REAL(linkat)(there, from, here, to, flags);
}

int unlink(const char *path) {
    change("unlink", path);
    return REAL(unlink)(path);
}
