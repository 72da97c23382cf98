/* Calls of C libraries that can be counted and made to fail, one of them at a time; loaded with LD_PRELOAD.
 *
 * It wraps the calls of libc by which pycolmap, PoCL, Pillow and NumPy reach files, and large allocations of all
 * libraries. libfiu (1.1 in Debian) was considered: it fails a kind of call always, once, by chance or below a
 * function. It has no filter for paths, so that "the third write to database.db" cannot be asked for.
 *
 * Files count if they are in the folder BELOW_ROOT, and if the call does not come from the interpreter itself, whose
 * calls failing_calls.py fails. Allocations of at least BELOW_BYTES count as soon as a file of the folder has been
 * used, so that the start of the interpreter cannot fail. With BELOW_LOG, a line for each call is appended to this
 * file: "process number kind name", where the process is "main" or "child", and the name is the path in the folder
 * or, for an allocation, the library that asks for it.
 *
 * BELOW_POINT is "process kind number errno lasting pattern": of the calls of this kind that a process makes and
 * whose name matches the pattern of fnmatch, the one of this number fails (from 0), in the first process that gets so
 * far. A lasting one fails all later calls for space too, those of the interpreter included. The file BELOW_STATE is
 * made when it fails, and tells the other processes. The variables are read when a process starts, and by below_start,
 * which a forked process calls.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <fnmatch.h>
#include <limits.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

#define CALLER __builtin_return_address(0)
#define REAL(name) ((__typeof__(&name))real(#name, &next_##name))
#define NEXT(name) static _Atomic(void *) next_##name

static char root[PATH_MAX], log_path[PATH_MAX], state[PATH_MAX];
static char point_kind[16], pattern[PATH_MAX];
static size_t root_length, bytes_min;
static long point_number;
static int point_errno, point_lasting, point_here, is_main;
static atomic_long matched;
static atomic_int used, reached;
static void *interpreter;
static __thread int inside;

extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t);
extern void *__libc_memalign(size_t, size_t);

static void *real(const char *name, _Atomic(void *) *next) {
    if (!*next)
        *next = dlsym(RTLD_NEXT, name);
    return *next;
}

static void copy(char *target, const char *variable) {
    const char *value = getenv(variable);
    snprintf(target, PATH_MAX, "%s", value ? value : "");
}

__attribute__((constructor)) void below_start(void) {
    char process[16] = "", name[32];
    Dl_info about;
    copy(root, "BELOW_ROOT");
    copy(log_path, "BELOW_LOG");
    copy(state, "BELOW_STATE");
    root_length = strlen(root);
    bytes_min = getenv("BELOW_BYTES") ? strtoul(getenv("BELOW_BYTES"), NULL, 10) : SIZE_MAX;
    matched = used = reached = point_here = 0;
    if (getenv("BELOW_POINT") &&
        sscanf(getenv("BELOW_POINT"), "%15s %15s %ld %d %d %4095[^\n]", process, point_kind, &point_number,
               &point_errno, &point_lasting, pattern) != 6)
        abort();
    is_main = !getenv("BELOW_MAIN");
    if (root_length && is_main) { /* the processes that this one starts find it, and are children */
        snprintf(name, sizeof name, "%d", getpid());
        setenv("BELOW_MAIN", name, 1);
    }
    point_here = !strcmp(process, is_main ? "main" : "child");
    void *symbol = dlsym(RTLD_DEFAULT, "Py_BytesMain");
    interpreter = symbol && dladdr(symbol, &about) ? about.dli_fbase : NULL;
}

static void append(const char *path, const char *line) {
    int file = syscall(SYS_openat, AT_FDCWD, path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
    if (file >= 0) {
        syscall(SYS_write, file, line, strlen(line));
        syscall(SYS_close, file);
    }
}

/* Count a call; the error that it ends with, or 0. */
static int counted(const char *kind, const char *name, int takes_space) {
    int fails = 0;
    if (*log_path) {
        char line[PATH_MAX + 64];
        snprintf(line, sizeof line, "%s %d %s %s\n", is_main ? "main" : "child", getpid(), kind, name);
        append(log_path, line);
    }
    if (!*state)
        return 0;
    if (point_here && !strcmp(kind, point_kind) && !fnmatch(pattern, name, 0))
        fails = matched++ == point_number && syscall(SYS_faccessat, AT_FDCWD, state, F_OK) != 0;
    if (fails) {
        reached = 1;
        append(state, kind);
    } else if (point_lasting && takes_space)
        fails = reached || syscall(SYS_faccessat, AT_FDCWD, state, F_OK) == 0;
    return fails ? point_errno : 0;
}

static void *base_of(void *caller, const char **library) {
    Dl_info about;
    if (!dladdr(caller, &about))
        return NULL;
    const char *last = strrchr(about.dli_fname, '/');
    *library = last ? last + 1 : about.dli_fname;
    return about.dli_fbase;
}

/* The error that a call on a file ends with, or 0. */
static int file_error(const char *kind, int folder, const char *path, void *caller, int takes_space) {
    char whole[2 * PATH_MAX] = "";
    const char *library = "";
    int before = errno, error = 0;
    if (!root_length || inside || !path)
        return 0;
    inside = 1;
    if (*path != '/') {
        char link[64];
        snprintf(link, sizeof link, folder == AT_FDCWD ? "/proc/self/cwd" : "/proc/self/fd/%d", folder);
        ssize_t length = syscall(SYS_readlinkat, AT_FDCWD, link, whole, PATH_MAX);
        whole[length > 0 ? length : 0] = 0;
        strcat(whole, "/");
    }
    strncat(whole, path, PATH_MAX - 1);
    if (!strncmp(whole, root, root_length) && whole[root_length] == '/') {
        used = 1;
        if (!interpreter || base_of(caller, &library) != interpreter)
            error = counted(kind, whole + root_length + 1, takes_space);
        else if (point_lasting && takes_space && (reached || syscall(SYS_faccessat, AT_FDCWD, state, F_OK) == 0))
            error = point_errno; /* a full disk is full for the interpreter too */
    }
    inside = 0;
    errno = error ? error : before;
    return error;
}

/* The same for an open file. */
static int open_error(const char *kind, int file, void *caller, int takes_space) {
    char link[64], path[PATH_MAX];
    if (!root_length || inside || file < 0)
        return 0;
    int before = errno;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = syscall(SYS_readlinkat, AT_FDCWD, link, path, sizeof path - 1);
    errno = before;
    if (length <= 0 || *path != '/')
        return 0;
    path[length] = 0;
    return file_error(kind, AT_FDCWD, path, caller, takes_space);
}

static int memory_error(size_t bytes, void *caller) {
    const char *library = "unknown";
    int before = errno, error;
    if (bytes < bytes_min || !used || inside)
        return 0;
    inside = 1;
    base_of(caller, &library);
    error = counted("allocate", library, 0);
    inside = 0;
    errno = error ? error : before;
    return error;
}

#define OPENS(name)                                                                                          \
    NEXT(name);                                                                                              \
    int name(const char *path, int flags, ...) {                                                             \
        va_list more;                                                                                        \
        va_start(more, flags);                                                                               \
        int mode = va_arg(more, int);                                                                        \
        va_end(more);                                                                                        \
        int writes = flags & (O_WRONLY | O_RDWR | O_CREAT);                                                  \
        int fails = file_error(writes ? "create" : "open", AT_FDCWD, path, CALLER, flags & O_CREAT);         \
        return fails ? -1 : REAL(name)(path, flags, mode);                                                   \
    }
OPENS(open)
OPENS(open64)

#define OPENS_AT(name)                                                                                       \
    NEXT(name);                                                                                              \
    int name(int folder, const char *path, int flags, ...) {                                                 \
        va_list more;                                                                                        \
        va_start(more, flags);                                                                               \
        int mode = va_arg(more, int);                                                                        \
        va_end(more);                                                                                        \
        int writes = flags & (O_WRONLY | O_RDWR | O_CREAT);                                                  \
        int fails = file_error(writes ? "create" : "open", folder, path, CALLER, flags & O_CREAT);           \
        return fails ? -1 : REAL(name)(folder, path, flags, mode);                                           \
    }
OPENS_AT(openat)
OPENS_AT(openat64)

#define FOPENS(name)                                                                                         \
    NEXT(name);                                                                                              \
    FILE *name(const char *path, const char *mode) {                                                         \
        int writes = strpbrk(mode, "wa+") != NULL;                                                           \
        int fails = file_error(writes ? "create" : "open", AT_FDCWD, path, CALLER, strpbrk(mode, "wa") != 0);  \
        return fails ? NULL : REAL(name)(path, mode);                                                        \
    }
FOPENS(fopen)
FOPENS(fopen64)

/* A call on an open file that fails as a whole. */
#define ON_FILE(result, name, kind, takes_space, parameters, arguments)                                      \
    NEXT(name);                                                                                              \
    result name parameters { return open_error(kind, file, CALLER, takes_space) ? -1 : REAL(name) arguments; }
ON_FILE(ssize_t, read, "read", 0, (int file, void *data, size_t size), (file, data, size))
ON_FILE(ssize_t, pread, "read", 0, (int file, void *data, size_t size, off_t at), (file, data, size, at))
ON_FILE(ssize_t, pread64, "read", 0, (int file, void *data, size_t size, off64_t at), (file, data, size, at))
ON_FILE(ssize_t, readv, "read", 0, (int file, const struct iovec *parts, int count), (file, parts, count))
ON_FILE(ssize_t, writev, "write", 1, (int file, const struct iovec *parts, int count), (file, parts, count))
ON_FILE(int, ftruncate, "truncate", 0, (int file, off_t size), (file, size))
ON_FILE(int, ftruncate64, "truncate", 0, (int file, off64_t size), (file, size))
ON_FILE(int, fallocate, "write", 1, (int file, int mode, off_t at, off_t size), (file, mode, at, size))
ON_FILE(int, fsync, "fsync", 0, (int file), (file))
ON_FILE(int, fdatasync, "fsync", 0, (int file), (file))

/* A write that fails has written the first half. */
#define WRITES(name, parameters, half, arguments)                                                            \
    NEXT(name);                                                                                              \
    ssize_t name parameters {                                                                                \
        int fails = open_error("write", file, CALLER, 1);                                                    \
        if (!fails)                                                                                          \
            return REAL(name) arguments;                                                                     \
        if (REAL(name) half < 0)                                                                             \
            return -1;                                                                                       \
        errno = fails;                                                                                       \
        return -1;                                                                                           \
    }
WRITES(write, (int file, const void *data, size_t size), (file, data, size / 2), (file, data, size))
WRITES(pwrite, (int file, const void *data, size_t size, off_t at), (file, data, size / 2, at), (file, data, size, at))
WRITES(pwrite64, (int file, const void *data, size_t size, off64_t at), (file, data, size / 2, at),
       (file, data, size, at))

NEXT(fread);
size_t fread(void *data, size_t size, size_t count, FILE *file) {
    return open_error("read", fileno(file), CALLER, 0) ? 0 : REAL(fread)(data, size, count, file);
}

NEXT(fwrite);
size_t fwrite(const void *data, size_t size, size_t count, FILE *file) {
    int fails = open_error("write", fileno(file), CALLER, 1);
    if (!fails)
        return REAL(fwrite)(data, size, count, file);
    size_t written = REAL(fwrite)(data, size, count / 2, file);
    errno = fails;
    return written;
}

NEXT(fflush);
int fflush(FILE *file) {
    return file && open_error("write", fileno(file), CALLER, 1) ? EOF : REAL(fflush)(file);
}

NEXT(fclose);
int fclose(FILE *file) { /* closing writes what is in the buffer; files that are only read have nothing there */
    int flags = fcntl(fileno(file), F_GETFL);
    int fails = flags != -1 && (flags & O_ACCMODE) != O_RDONLY ? open_error("write", fileno(file), CALLER, 1) : 0;
    int result = REAL(fclose)(file);
    if (fails)
        errno = fails;
    return fails ? EOF : result;
}

/* A call on a path that fails as a whole. */
#define ON_PATH(name, kind, takes_space, folder, parameters, arguments)                                      \
    NEXT(name);                                                                                              \
    int name parameters { return file_error(kind, folder, path, CALLER, takes_space) ? -1 : REAL(name) arguments; }
ON_PATH(rename, "replace", 0, AT_FDCWD, (const char *old, const char *path), (old, path))
ON_PATH(mkdir, "mkdir", 1, AT_FDCWD, (const char *path, mode_t mode), (path, mode))
ON_PATH(unlink, "unlink", 0, AT_FDCWD, (const char *path), (path))
ON_PATH(remove, "unlink", 0, AT_FDCWD, (const char *path), (path))
ON_PATH(rmdir, "rmdir", 0, AT_FDCWD, (const char *path), (path))
ON_PATH(unlinkat, "unlink", 0, folder, (int folder, const char *path, int flags), (folder, path, flags))

NEXT(dlopen);
void *dlopen(const char *path, int flags) {
    if (path && *path == '/' && file_error("load", AT_FDCWD, path, CALLER, 0))
        path = "/nonexistent"; /* so that dlerror has a message */
    return REAL(dlopen)(path, flags);
}

#define MAPS(name, offset)                                                                                   \
    NEXT(name);                                                                                              \
    void *name(void *at, size_t size, int access, int flags, int file, offset from) {                        \
        int fails = file < 0 ? memory_error(size, CALLER) : open_error("map", file, CALLER, 0);              \
        return fails ? MAP_FAILED : REAL(name)(at, size, access, flags, file, from);                         \
    }
MAPS(mmap, off_t)
MAPS(mmap64, off64_t)

void *malloc(size_t size) { return memory_error(size, CALLER) ? NULL : __libc_malloc(size); }

void *calloc(size_t count, size_t size) {
    return memory_error(count * size, CALLER) ? NULL : __libc_calloc(count, size);
}

void *realloc(void *old, size_t size) { return memory_error(size, CALLER) ? NULL : __libc_realloc(old, size); }

void *aligned_alloc(size_t alignment, size_t size) {
    return memory_error(size, CALLER) ? NULL : __libc_memalign(alignment, size);
}

void *memalign(size_t alignment, size_t size) {
    return memory_error(size, CALLER) ? NULL : __libc_memalign(alignment, size);
}

int posix_memalign(void **result, size_t alignment, size_t size) {
    int error = memory_error(size, CALLER);
    if (!error && !(*result = __libc_memalign(alignment, size)))
        error = ENOMEM;
    return error;
}
