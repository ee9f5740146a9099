# Makes the lab's CAN interfaces in the network namespace of whoever sources this.
ip link set lo up &&
    ip link add dev vcan0 type vcan &&
    ip link add dev vcan1 type vcan &&
    ip link add dev vxcan0 type vxcan peer name vxcan1 &&
    for interface in vcan0 vcan1 vxcan0 vxcan1; do
        ip link set "$interface" up || break
    done &&
    ip -brief link show vxcan1 up >/dev/null
