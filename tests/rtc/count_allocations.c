/* Preloaded into an HRTC: counts allocations asked for by the frame path's own code, and those that the middleware makes
 * on the loop's thread, once it takes messages. What it found goes to the file $ALLOCATIONS when the process ends, and that
 * it can see: how many of the libraries it knows, and what it counted of allocations that one of them made on purpose. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <link.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

extern void *__libc_malloc(size_t), *__libc_calloc(size_t, size_t), *__libc_realloc(void *, size_t),
    *__libc_memalign(size_t, size_t);

static atomic_long own, others, takes, on_purpose;
static _Thread_local int in_loop;
static struct {
    const char *name, *path;
    uintptr_t start, end;
} code[2] = {{.name = "libsrtomo_frame.so"}, {.name = "libsrtomo_frame_ros.so"}};

/* the frame path's libraries, once they are loaded */
static int find(struct dl_phdr_info *info, size_t size, void *data)
{
    (void)size, (void)data;
    for (int which = 0; which < 2; which++)
        for (int i = 0; strstr(info->dlpi_name, code[which].name) && i < info->dlpi_phnum; i++)
            if (info->dlpi_phdr[i].p_type == PT_LOAD && info->dlpi_phdr[i].p_flags & PF_X) {
                code[which].start = info->dlpi_addr + info->dlpi_phdr[i].p_vaddr;
                code[which].end = code[which].start + info->dlpi_phdr[i].p_memsz;
                code[which].path = info->dlpi_name;
            }
    return 0;
}

static void count(void *caller)
{
    uintptr_t at = (uintptr_t)caller;
    if ((at >= code[0].start && at < code[0].end) || (at >= code[1].start && at < code[1].end))
        own++;
    else if (in_loop)
        others++;
}

void *malloc(size_t size)
{
    count(__builtin_return_address(0));
    return __libc_malloc(size);
}

void *calloc(size_t n, size_t size)
{
    count(__builtin_return_address(0));
    return __libc_calloc(n, size);
}

void *realloc(void *old, size_t size)
{
    count(__builtin_return_address(0));
    return __libc_realloc(old, size);
}

void *aligned_alloc(size_t alignment, size_t size)
{
    count(__builtin_return_address(0));
    return __libc_memalign(alignment, size);
}

int posix_memalign(void **made, size_t alignment, size_t size)
{
    count(__builtin_return_address(0));
    *made = __libc_memalign(alignment, size);
    return *made ? 0 : ENOMEM;
}

/* A loop that nobody needs: what its making asks for has to be seen, or nothing would be. */
static void allocate_on_purpose(void)
{
    void *(*make)(const uint32_t *, uint32_t, uint32_t, float, uint32_t, uint32_t);
    void (*drop)(void *);
    void *library = code[0].path ? dlopen(code[0].path, RTLD_LAZY | RTLD_NOLOAD) : NULL;
    *(void **)&make = library ? dlsym(library, "srt_loop_new") : NULL;
    *(void **)&drop = library ? dlsym(library, "srt_loop_free") : NULL;
    if (!make || !drop)
        return;
    uint32_t n_subapertures = 1;
    long before = own;
    drop(make(&n_subapertures, 1, 1, 2.0f, 1, 0));
    on_purpose = own - before;
    own = before;
}

/* what the loop's thread alone calls */
int rcl_take_serialized_message(const void *subscription, void *message, void *info, void *allocation)
{
    static int (*real)(const void *, void *, void *, void *);
    if (!real) {
        *(void **)&real = dlsym(RTLD_NEXT, "rcl_take_serialized_message");
        if (!real)
            *(void **)&real = dlsym(dlopen("librcl.so", RTLD_LAZY), "rcl_take_serialized_message");
        dl_iterate_phdr(find, NULL);
        allocate_on_purpose();
        in_loop = 1;
    }
    takes++;
    return real(subscription, message, info, allocation);
}

__attribute__((destructor)) static void tell(void)
{
    const char *path = getenv("ALLOCATIONS");
    FILE *file = path ? fopen(path, "w") : NULL;
    if (file) {
        fprintf(file, "own %ld\nmiddleware %ld\ntakes %ld\non_purpose %ld\nlibraries %d\n", (long)own, (long)others,
                (long)takes, (long)on_purpose, !!code[0].path + !!code[1].path);
        fclose(file);
    }
}
