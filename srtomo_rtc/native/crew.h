/* Threads that form a product together: each takes whole tiles, so that no sum's order depends on how many there are. */
#ifndef SRTOMO_CREW_H
#define SRTOMO_CREW_H

#include <stddef.h>
#include <stdint.h>

#include "kernel.h"

/* The helpers of one caller. They look for work for a while, then sleep; the caller never waits for one that sleeps or
 * has not begun, since it takes whatever tiles are left itself. */
typedef struct srt_crew srt_crew;

enum { SRT_MAX_HELPERS = 63 };

/* helpers: threads beside the caller's; spin_ns: how long each looks for more work before it sleeps; least_bytes: of
 * tiles, below which the caller works alone. NULL: no memory, no such thread, or too many. */
srt_crew *srt_crew_new(uint32_t helpers, int64_t spin_ns, size_t least_bytes);
/* Ends the threads. Not while a product is under way; NULL does nothing. */
void srt_crew_free(srt_crew *crew);
/* A helper's thread, for the scheduler's calls. */
int32_t srt_crew_thread(const srt_crew *crew, uint32_t helper);

/* Items from .. to - 1 of some work. */
typedef void (*srt_part)(const void *work, size_t from, size_t to);

/* part of all n items, shared with the helpers; bytes: of matrix that are read. One thread at a time calls it. */
void srt_crew_share(srt_crew *crew, srt_part part, const void *work, size_t n, size_t bytes);

/* srt_multiply of every tile, shared with the helpers; NULL: there are none. One thread at a time calls it. */
void srt_crew_multiply(srt_crew *crew, const srt_product *product);

#endif
