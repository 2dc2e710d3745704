/* Preloaded into a writer: ends it with SIGKILL at the n-th call that changes a folder, lets that
   call fail, or writes down the calls. Threads may call at once. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

static long left = -1;
static int record = -1;
static int fault = 0;
static char folder[PATH_MAX];

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* Counts from here: the call number `at` in `where` is the last, 0 for none. */
void crash_at(long at, const char *where) {
    strncpy(folder, where, sizeof folder - 1);
    left = at;
}

/* That call then fails with this error number, and the writer goes on. */
void fail_with(int error) { fault = error; }

/* Calls before the last one; below one if it has come. */
long calls_left(void) { return __atomic_load_n(&left, __ATOMIC_SEQ_CST); }

/* Writes a line for every call from here to an open file. */
void record_to(int descriptor) { record = descriptor; }

/* With this variable, the name of a folder, a line for every call goes to standard error. */
__attribute__((constructor)) static void record_all(void) {
    if (!getenv("RECORDED")) return;
    crash_at(0, getenv("RECORDED"));
    record_to(2);
}

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

/* What the last call gives if the writer lives: always -1. */
static int end(void) {
    if (!fault) {
        kill(getpid(), SIGKILL);
        pause();
    }
    errno = fault;
    return -1;
}

static int is_last(void) {
    long now = __atomic_load_n(&left, __ATOMIC_SEQ_CST);
    return now > 0 && __atomic_sub_fetch(&left, 1, __ATOMIC_SEQ_CST) == 0;
}

ssize_t write(int descriptor, const void *content, size_t size) {
    char path[PATH_MAX];
    if (descriptor != record && path_of(descriptor, path)) {
        note("write", path);
        if (is_last()) return end();
        if (is_last()) {
            ssize_t half = REAL(write)(descriptor, content, size / 2);
            return fault ? half : end();
        }
    }
    return REAL(write)(descriptor, content, size);
}

int fsync(int descriptor) {
    char path[PATH_MAX];
    if (path_of(descriptor, path)) {
        note("fsync", path);
        if (is_last()) return end();
    }
    return REAL(fsync)(descriptor);
}

static int change(const char *call, const char *path) {
    if (!is_inside(path)) return 0;
    note(call, path);
    return is_last() ? end() : 0;
}

int rename(const char *from, const char *to) {
    if (change("rename", to)) return -1;
    return REAL(rename)(from, to);
}

/* With this variable the file system has no hard links. */
static int lacks_links(void) {
    if (!getenv("WITHOUT_LINKS")) return 0;
    errno = EPERM;
    return 1;
}

int link(const char *from, const char *to) {
    if (lacks_links()) return -1;
    if (change("link", to)) return -1;
    return REAL(link)(from, to);
}

int linkat(int there, const char *from, int here, const char *to, int flags) {
    if (lacks_links()) return -1;
    if (change("link", to)) return -1;
    return REAL(linkat)(there, from, here, to, flags);
}

int unlink(const char *path) {
    if (change("unlink", path)) return -1;
    return REAL(unlink)(path);
}
