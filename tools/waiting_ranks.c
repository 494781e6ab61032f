// A rank that waits for others yields its processor for 0.2 ms, then sleeps between two looks.
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec + 1e-9 * t.tv_nsec;
}

int sched_yield(void) {
    static double began, last;
    double t = now();
    if (t - last > 50e-6)
        began = t;
    if (t - began < 200e-6)
        syscall(SYS_sched_yield);
    else
        nanosleep(&(struct timespec){.tv_nsec = 20000}, 0);
    last = now();
    return 0;
}
