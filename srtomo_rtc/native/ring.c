/* Writes to a ring whose layout, and whose other side, is srtomo_core/ring.py. */
#include <string.h>

#include "frame.h"

enum {
    CLAIMED = 64,
    WRITTEN = 128,
    DATA = 4096,
};

static const uint32_t FILLER = 0xFFFFFFFF;

typedef struct {
    uint32_t size, channel;
    uint64_t number, time_ns, length;
} record;

_Static_assert(sizeof(record) == 32, "as in srtomo_core/ring.py");

/* Before a byte of what is claimed changes: a reader that sees the change sees the claim. */
static void claim(srt_ring *ring, uint64_t end)
{
    atomic_store_explicit((_Atomic uint64_t *)(ring->memory + CLAIMED), end, memory_order_relaxed);
    atomic_thread_fence(memory_order_release);
}

void srt_ring_write(srt_ring *ring, uint32_t channel, int64_t now_ns, const uint8_t *message, size_t size)
{
    if (!ring->memory)
        return;
    record head = {.channel = channel, .number = ring->number++, .length = size};
    head.time_ns = (uint64_t)(now_ns + ring->ahead);
    uint64_t whole = (sizeof head + (uint64_t)size + 15) / 16 * 16;
    if (whole > ring->capacity / 2)
        return;
    head.size = (uint32_t)whole;
    uint8_t *data = ring->memory + DATA;
    uint64_t place = ring->position % ring->capacity, rest = ring->capacity - place;
    if (rest < whole) {
        claim(ring, ring->position + rest);
        memcpy(data + place, &(uint32_t){(uint32_t)rest}, 4); /* sizes are multiples of 16: there is room for it */
        memcpy(data + place + 4, &FILLER, 4);
        ring->position += rest;
        place = 0;
    }
    claim(ring, ring->position + whole);
    memcpy(data + place, &head, sizeof head);
    memcpy(data + place + sizeof head, message, size);
    ring->position += whole;
    atomic_store_explicit((_Atomic uint64_t *)(ring->memory + WRITTEN), ring->position, memory_order_release);
}
