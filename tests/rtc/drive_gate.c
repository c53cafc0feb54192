/* What the loop's thread does with messages, out of the interpreter and without ROS: built by test_threads.py. */
#include <string.h>
#include <time.h>

#include "frame.h"

typedef struct {
    uint8_t *commands; /* of `size` bytes each */
    size_t size, count, room;
} kept;

int keep(void *context, const void *message, size_t size)
{
    kept *to = context;
    if (size != to->size || to->count == to->room)
        return 1;
    memcpy(to->commands + to->count++ * size, message, size);
    return 0;
}

enum { AT_A_TIME = 50 };

/* Offer `n` messages of `size` bytes, one after the other, with pauses in which another thread gets the core. */
int drive(srt_gate *gate, const uint8_t *messages, size_t size, size_t n)
{
    srt_gate_start(gate);
    for (size_t i = 0; i < n && !gate->failure; i++) {
        srt_gate_offer(gate, messages + i * size, size, srt_now());
        srt_gate_advance(gate);
        srt_gate_idle(gate, srt_now());
        if (i % AT_A_TIME == 0)
            nanosleep(&(struct timespec){.tv_nsec = 1000000}, NULL);
    }
    return gate->failure;
}
