#define _GNU_SOURCE
#include "crew.h"

#include <limits.h>
#include <linux/futex.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdbool.h>
#include <stdlib.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

enum {
    PIECES = 4,           /* of a member's share: the caller can take what a late helper has not begun */
    LOOKS = 64,           /* for work between two looks at the clock */
    STACK = 256 << 10,    /* bytes a thread; all of it is locked */
    LINE = 128,           /* bytes that processors pass on together */
};

/* A member's share is the same tiles whenever the size is: they stay in its core's cache. */
typedef struct {
    _Alignas(LINE) atomic_int left; /* pieces that nobody has begun; below 0: looked for in vain */
    srt_crew *crew;
    pthread_t handle;
    atomic_int thread;
} member;

struct srt_crew {
    member members[SRT_MAX_HELPERS + 1]; /* the caller first */
    uint32_t n_members;
    int64_t spin_ns;
    size_t least_bytes;
    /* written while no piece is left, read by who has begun one */
    srt_part part;
    const void *work;
    size_t n;
    _Alignas(LINE) _Atomic uint32_t number; /* of the product, and the futex that helpers sleep on */
    atomic_int asleep;
    atomic_bool over;
    _Alignas(LINE) atomic_uint unfinished; /* pieces */
};

_Static_assert(sizeof(_Atomic uint32_t) == 4, "a futex is a word");

static void rest(void)
{
#if defined(__x86_64__)
    __builtin_ia32_pause();
#endif
}

static int64_t now(void)
{
    struct timespec time;
    clock_gettime(CLOCK_MONOTONIC, &time);
    return time.tv_sec * 1000000000ll + time.tv_nsec;
}

/* Do pieces of one member's share until none is left. */
static void do_share(srt_crew *crew, uint32_t of)
{
    int piece;
    while ((piece = atomic_fetch_sub_explicit(&crew->members[of].left, 1, memory_order_acquire)) > 0) {
        size_t pieces = (size_t)crew->n_members * PIECES, which = (size_t)of * PIECES + (size_t)(piece - 1);
        size_t from = crew->n * which / pieces, to = crew->n * (which + 1) / pieces;
        if (to > from)
            crew->part(crew->work, from, to);
        atomic_fetch_sub_explicit(&crew->unfinished, 1, memory_order_release);
    }
}

/* Until another product than `seen` has come, or the crew is over. */
static void await(srt_crew *crew, uint32_t seen)
{
    for (int64_t end = now() + crew->spin_ns; now() < end;)
        for (int i = 0; i < LOOKS; i++) {
            if (atomic_load_explicit(&crew->number, memory_order_acquire) != seen)
                return;
            rest();
        }
    atomic_fetch_add(&crew->asleep, 1);
    while (atomic_load(&crew->number) == seen)
        syscall(SYS_futex, &crew->number, FUTEX_WAIT_PRIVATE, seen, NULL, NULL, 0);
    atomic_fetch_sub(&crew->asleep, 1);
}

static void *help(void *argument)
{
    member *self = argument;
    srt_crew *crew = self->crew;
    atomic_store(&self->thread, (int)syscall(SYS_gettid));
    for (uint32_t seen = 0; !atomic_load(&crew->over);) {
        await(crew, seen);
        seen = atomic_load(&crew->number);
        do_share(crew, (uint32_t)(self - crew->members));
    }
    return NULL;
}

/* The caller never stops here: it only says that there is something, and to those asleep through the kernel. */
static void announce(srt_crew *crew)
{
    atomic_fetch_add(&crew->number, 1);
    if (atomic_load(&crew->asleep) > 0)
        syscall(SYS_futex, &crew->number, FUTEX_WAKE_PRIVATE, INT_MAX, NULL, NULL, 0);
}

static bool start(srt_crew *crew, uint32_t helpers)
{
    pthread_attr_t attributes;
    if (pthread_attr_init(&attributes) != 0)
        return false;
    bool started = pthread_attr_setstacksize(&attributes, STACK) == 0;
    /* signals are for the interpreter's threads */
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &before);
    for (uint32_t i = 1; started && i <= helpers; i++) {
        member *one = &crew->members[i];
        one->crew = crew;
        started = pthread_create(&one->handle, &attributes, help, one) == 0;
        if (started) {
            crew->n_members++;
            pthread_setname_np(one->handle, "srtomo-helper");
            while (!atomic_load(&one->thread))
                sched_yield();
        }
    }
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    pthread_attr_destroy(&attributes);
    return started;
}

srt_crew *srt_crew_new(uint32_t helpers, int64_t spin_ns, size_t least_bytes)
{
    if (helpers > SRT_MAX_HELPERS)
        return NULL;
    srt_crew *crew = aligned_alloc(LINE, sizeof *crew);
    if (!crew)
        return NULL;
    *crew = (srt_crew){.n_members = 1, .spin_ns = spin_ns, .least_bytes = least_bytes};
    if (!start(crew, helpers)) {
        srt_crew_free(crew);
        return NULL;
    }
    return crew;
}

void srt_crew_free(srt_crew *crew)
{
    if (!crew)
        return;
    atomic_store(&crew->over, true);
    announce(crew);
    for (uint32_t i = 1; i < crew->n_members; i++)
        pthread_join(crew->members[i].handle, NULL);
    free(crew);
}

int32_t srt_crew_thread(const srt_crew *crew, uint32_t helper)
{
    return helper + 1 < crew->n_members ? atomic_load(&crew->members[helper + 1].thread) : 0;
}

void srt_crew_share(srt_crew *crew, srt_part part, const void *work, size_t n, size_t bytes)
{
    if (!crew || crew->n_members == 1 || bytes < crew->least_bytes) {
        part(work, 0, n);
        return;
    }
    crew->part = part;
    crew->work = work;
    crew->n = n;
    atomic_store_explicit(&crew->unfinished, crew->n_members * PIECES, memory_order_relaxed);
    for (uint32_t i = 0; i < crew->n_members; i++)
        atomic_store_explicit(&crew->members[i].left, PIECES, memory_order_release);
    announce(crew);
    for (uint32_t i = 0; i < crew->n_members; i++)
        do_share(crew, i);
    while (atomic_load_explicit(&crew->unfinished, memory_order_acquire))
        rest();
}

static void multiply(const void *product, size_t from, size_t to)
{
    srt_multiply(product, from, to);
}

void srt_crew_multiply(srt_crew *crew, const srt_product *product)
{
    size_t bytes = product->n_tiles * (product->last - product->first) * SRT_COLUMN;
    srt_crew_share(crew, multiply, product, product->n_tiles, bytes);
}
