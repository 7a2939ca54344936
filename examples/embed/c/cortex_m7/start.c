/* From reset to main on a Cortex-M7, and what main returns to the host of the debugger: of the self-test, in qemu. On your
   board its maker's start-up files do this. */

#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

extern char data_in_flash, data_begin, data_end, bss_begin, bss_end, stack_top; /* of mps2_an500.ld */
extern int main(void);
extern void initialise_monitor_handles(void); /* of newlib: printf goes to the debugger */

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* CPACR: the floating point unit is on */
    __asm volatile("dsb\n isb");
    memcpy(&data_begin, &data_in_flash, (size_t)(&data_end - &data_begin));
    memset(&bss_begin, 0, (size_t)(&bss_end - &bss_begin));
    initialise_monitor_handles();
    const int status = main();
    fflush(NULL);
    _exit(status);
}

static void fault(void)
{
    _exit(3);
}

/* The stack's first place, and where reset and faults go. */
__attribute__((section(".vectors"), used)) static const void *const VECTORS[8] = {
    &stack_top, (const void *)reset, (const void *)fault, (const void *)fault,
    (const void *)fault, (const void *)fault, (const void *)fault, (const void *)fault};
