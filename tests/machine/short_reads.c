/* A library to be preloaded: reads of regular files return less than was asked for, as those of network folders may. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <sys/stat.h>
#include <unistd.h>

static size_t less(int file, size_t size) {
    struct stat status;
    if (size < 2 || fstat(file, &status) || !S_ISREG(status.st_mode)) return size;
    return size > 4099 ? 4099 : size / 2 + 1;
}

ssize_t read(int file, void *into, size_t size) {
    static ssize_t (*whole)(int, void *, size_t);
    if (!whole) whole = dlsym(RTLD_NEXT, "read");
    return whole(file, into, less(file, size));
}

ssize_t pread(int file, void *into, size_t size, off_t place) {
    static ssize_t (*whole)(int, void *, size_t, off_t);
    if (!whole) whole = dlsym(RTLD_NEXT, "pread");
    return whole(file, into, less(file, size), place);
}

ssize_t pread64(int file, void *into, size_t size, off64_t place) {
    static ssize_t (*whole)(int, void *, size_t, off64_t);
    if (!whole) whole = dlsym(RTLD_NEXT, "pread64");
    return whole(file, into, less(file, size), place);
}
